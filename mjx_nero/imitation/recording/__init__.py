"""Records the episodes of an agent, with pictures, as data sets of demonstrations."""
