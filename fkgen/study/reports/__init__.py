"""What people look at: figures, the demo, progress, starters."""
