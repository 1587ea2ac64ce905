"""Show points on a browser page and serve the page."""
