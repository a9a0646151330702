"""The stages of the method: pure functions on arrays, without files or logging."""
