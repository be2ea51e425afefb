"""The leaderboard: submissions that contain only data, recomputed scores, a board and a page.

Nothing here is imported by ``import lag_envs``.
"""
