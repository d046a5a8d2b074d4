"""What all parts use: errors, units, files, reports as text and HTML, compiled code."""
