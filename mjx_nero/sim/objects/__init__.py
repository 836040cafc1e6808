"""Free objects of a scene: primitive shapes, and solids made of meshes (``sim.solids``)."""
