"""What one does with a filter: check its model, verify it, filter a record, draw the result."""
