"""Reading and writing files: safe access to input files, tables, archives and remote storage."""
