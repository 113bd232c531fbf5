"""Nonlinear model predictive control and closed-loop laps. Casadi is imported here."""
