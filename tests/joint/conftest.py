"""Exports share torch's table of operators."""

from export.tables import one_table_of_operators

_ = one_table_of_operators
