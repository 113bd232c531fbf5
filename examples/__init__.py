"""Programs to read and to run; the tests execute them."""
