"""The full tables of docs/results, made from the result files: a module for each page, a function for each table."""
