"""The ``dynssm`` command, one file per subcommand: a thin shell around functions of the other rooms."""
