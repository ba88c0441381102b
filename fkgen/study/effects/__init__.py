"""What a fault does to an estimate, and how small a fault a filter still finds."""
