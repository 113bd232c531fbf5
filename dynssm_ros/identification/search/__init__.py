"""Which effects the data ask for: candidates, their selection, and their confirmation on parts that were left out."""
