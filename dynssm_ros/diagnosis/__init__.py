"""What the simulation gets wrong, the cause by name, the extended model, the measured gain."""
