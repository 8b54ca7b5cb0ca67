"""How far views agree with one another, without a reference picture: depth, matches, features."""
