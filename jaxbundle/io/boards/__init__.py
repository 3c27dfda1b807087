"""Boards, and their image points, from files of other programs."""
