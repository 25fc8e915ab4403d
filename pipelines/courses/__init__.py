"""Courses over several grounds, and how well a classifier and a filter over time follow them."""
