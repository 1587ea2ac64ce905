"""Pictures, films and pages of scenes and points."""
