"""Functions f and h of a spec: from texts and from objects of other libraries to equations."""
