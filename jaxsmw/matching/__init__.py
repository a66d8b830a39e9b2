"""What a match is made of, in the order in which it runs.

`pair` → `preparation` → `starts` → `stages` → `executor` → `judge` → `search` → `correspondence` → `match`.
"""
