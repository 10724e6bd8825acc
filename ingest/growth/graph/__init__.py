"""What hangs on what: the pose graph of maps, the drift budget, maps that are placed anew."""
