"""What is phi? The energy, where it is feasible, and the search for states where it is not."""
