"""How does it learn? Loops, memory, networks, losses and the backends that step on them."""
