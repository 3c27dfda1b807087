"""What is written of a result: JSON, tables, drawings, the adjusted project."""
