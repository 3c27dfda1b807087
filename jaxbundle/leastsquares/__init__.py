"""A least-squares engine on tables of unknowns and kinds of observations; it knows no photograph.

In the making: the adjustment of networks does not stand on it yet.
"""
