"""`ddrecon bench`: speed against error, of every choice a scene leaves open, and of path tracing
where Mitsuba 3 is installed.
"""
