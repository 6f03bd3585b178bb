"""Flight: trajectory planning, time-varying LQR, closed-loop simulation, and corruption of logs."""
