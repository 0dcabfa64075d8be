"""Network definitions and the weights that ship, each with a model card beside it."""
