"""An XY stage under Grbl 1.1, grblHAL or FluidNC, over a serial port or a network.

stage.py       the Stage: connecting, motions
controller.py  what is at the end of the line: identity, settings, travel
condition.py   what is known of the stage: alarms, resets, where it is
homing.py      the way to a known position, and out of an alarm
standstill.py  hold, resume, stop
motion.py      motions as lines, the stream that carries them
link.py        the conversation: lines and their acknowledgements, reports, resets
protocol.py    what a controller says, as data
faults.py      alarms and errors by name
"""

from drivers.grbl.stage import GrblOptions, GrblStage

__all__ = ["GrblOptions", "GrblStage"]
