"""umbrad: everything between a command and a result."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("umbra-rig")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
