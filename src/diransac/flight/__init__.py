"""Flight: planned trajectories, time-varying LQR, closed loops, and logs as recorders corrupt them."""
