"""Records the episodes of whoever can do the task, with pictures, as data sets of demonstrations."""
