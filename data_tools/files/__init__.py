"""Reading and writing of files: atomic, by URL, tables, JSON streams."""
