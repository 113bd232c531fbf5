"""Tables, figures, pages and animations: one file per report. Imports matplotlib."""
