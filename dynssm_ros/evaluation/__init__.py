"""What a model is worth on recordings, for people and for programs: error measures, no figures."""
