"""The laser scanner of the simulated world: beams, echoes, strips, the scan and its file."""
