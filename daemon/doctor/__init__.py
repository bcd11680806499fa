"""`umbra doctor`: what is wrong with this rig, and what to do about it. One file a concern.

Each check is a function of facts (and, where it must expose, of a device's thread) that gives
`Check`s and never raises for what it is there to find.
"""
