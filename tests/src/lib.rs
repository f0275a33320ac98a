//! Whole-workspace tests: scan → package. The tests are in `tests/`.
