"""DynSSM: physics with adapted coefficients, an innovation filter and a gated residual."""
