"""What the benchmarks compare with is registered, as a plugin does it."""

import benchmarks.rivals  # noqa: F401 - registers them
