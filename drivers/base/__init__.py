"""What a device is, a kind a file: Camera, Projector, Stage, Light; and the errors they raise.

A driver is small: connect, identify, configure, act, halt, close. The daemon gives each device one
thread that makes all of its calls, so a driver needs no locks of its own, with one exception:
`halt()` may be called from any thread at any moment, also while another call is blocked, and makes
that call return or raise soon. A driver never sleeps for a fixed time where it can wait for an
event, and takes the time from its context's clock.

Each driver's docstring states which of its commands are safe to send again after a failure.
"""
