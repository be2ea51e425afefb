"""The subcommands of ``lag-envs``. What one needs is imported where it runs: ``--help`` stays quick."""
