"""How sure a reconstruction is: experiments with what it found, and what follows of them."""
