"""Reports and pictures of a result, and its folder."""
