"""Functions of tensors that know no optics."""
