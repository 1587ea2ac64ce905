"""The page of points in a browser, and the server of the page."""
