"""Public benchmark: structures, questions, submissions of any method, and a judge that trusts nothing in them."""
