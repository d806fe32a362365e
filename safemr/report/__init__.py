"""What is printed and drawn: statistics, tables, claims, and the figures."""
