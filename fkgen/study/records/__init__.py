"""Records of a user: reading, filtering, writing."""
