"""Scene files: their schema, how they are read (`load`) and become tensors (`build`)."""
