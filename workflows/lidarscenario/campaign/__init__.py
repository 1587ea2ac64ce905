"""Campaign files, and the jobs that are created from them."""
