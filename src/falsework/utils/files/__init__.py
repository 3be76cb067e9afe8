"""Files: outputs written whole, errors blamed on what is read, and text of files made safe to show."""
