"""A host filter beside a compression filter that is tested at the end of a window."""
