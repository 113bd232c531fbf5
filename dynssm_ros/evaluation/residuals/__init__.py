"""The anatomy of one-step errors: which patterns they have, how much of the squared error each holds, and by what chance."""
