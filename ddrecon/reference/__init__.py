"""Scenes in Mitsuba 3, an independent path tracer, so that anybody can check our images."""
