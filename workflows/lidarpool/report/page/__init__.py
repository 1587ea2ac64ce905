"""The report as a page: one HTML file that opens anywhere and asks for nothing."""
