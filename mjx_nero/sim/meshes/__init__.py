"""Free objects made of mesh files (``sim.solids``): their bodies, several shapes in a batch, and events that lay them down."""
