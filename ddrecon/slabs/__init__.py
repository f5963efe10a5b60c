"""A grid in slabs, one for each rank: which cells are whose, and what ranks exchange of them."""
