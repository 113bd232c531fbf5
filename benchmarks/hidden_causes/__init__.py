"""The hidden-cause benchmark: what ``diagnose`` is measured on.

``cases`` draws and drives them, ``run`` diagnoses, ``outcomes`` judges, ``page`` writes it down, ``dodo`` has the tasks.
"""
