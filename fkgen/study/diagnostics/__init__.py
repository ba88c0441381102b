"""What `check` looks at, one question a module."""
