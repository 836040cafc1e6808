"""Classical control: pure functions for one robot, vmapped for many."""
