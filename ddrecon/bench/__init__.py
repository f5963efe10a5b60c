"""`ddrecon bench`: speed against error, of every choice a scene leaves open and of path tracing.

Path tracing takes part where Mitsuba 3 is installed.
"""
