"""Packets of items that run in a processor's vector lanes (`packets.h`)."""

LANES = 16
"""Items in a packet on a processor."""
PACKETS = """
typedef Packets<F> P;
typedef P::V V;
typedef P::I I;
typedef P::W W;
typedef P::M M;
typedef P::IM IM;
"""
"""Begins a text whose items are packets: vectors `V` of numbers, and functions `P` of them."""
