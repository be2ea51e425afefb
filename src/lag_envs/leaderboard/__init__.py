"""The leaderboard: submissions that are data only, scores that are recomputed, a board and a page.

Nothing here is imported by ``import lag_envs``.
"""
