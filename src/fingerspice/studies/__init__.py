"""What is asked of many solutions, or beside them."""
