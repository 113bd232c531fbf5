"""The generalisation matrix: models where they were not trained. Development and test cells are told apart by a hash."""
