"""Processes of this machine, and what each of them keeps."""
