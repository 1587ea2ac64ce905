"""Files for other programs that list a sensor's rays or describe its scan pattern."""
