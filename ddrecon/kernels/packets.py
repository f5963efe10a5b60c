"""Packets of items that run in a processor's vector lanes (`packets.h`)."""

import re
from pathlib import Path

_HEADER = Path(__file__).with_suffix(".h").read_text(encoding="utf-8")
LANES = int(re.findall(r"LANES = (\d+);", _HEADER)[-1])
"""Items in a packet on a processor."""
