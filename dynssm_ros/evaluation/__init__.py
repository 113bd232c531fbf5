"""What a model is worth, for people and for programs: error measures, tables, figures, HTML reports."""
