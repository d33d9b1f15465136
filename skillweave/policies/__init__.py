"""Policies that act in N environments at once; NumPy alone, as exports are made of them."""
