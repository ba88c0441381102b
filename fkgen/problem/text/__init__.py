"""The expression language: text, matrices of expressions, values of other libraries."""
