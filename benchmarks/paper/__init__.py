"""The paper's open-loop evaluation and more as one run: a plan of steps, and the document made of their results.

:mod:`plan` says what is compared with what, :mod:`schedule` turns that into :mod:`steps`, :mod:`runner` does those that
are not done yet, :mod:`results` reads what came out, and :mod:`document` writes it down.
"""
