"""Packets of items that run in a processor's vector lanes (`packets.h`)."""

LANES = 16
"""Items in a packet on a processor."""
