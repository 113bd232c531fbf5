"""The trainable models: a contract, a registry, one file or folder per model."""
