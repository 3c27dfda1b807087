"""Output files of a result: JSON, tables, drawings, the adjusted project."""
