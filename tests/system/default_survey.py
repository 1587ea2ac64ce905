"""What the survey of the demo gives, by tiles as well as by NumPy."""

DEFAULT_CLOUD_SHA256 = "9012bcbf7aa44d9d07c95fae78e707887c40225f1bde1fcb304c674c220c0228"
