"""How sure a reconstruction is: samples of its posterior, and what they say together."""
