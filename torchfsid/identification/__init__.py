"""The inverse model: the active set, the KKT conditions, and the half-spaces of theta given by one measurement."""
