"""The subcommands of ``lag-envs``. Their imports are deferred until they run, so ``--help`` is quick."""
