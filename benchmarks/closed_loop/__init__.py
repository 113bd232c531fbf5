"""The robustness matrix: laps in closed loop, on tracks and cars that nothing was tuned on."""
