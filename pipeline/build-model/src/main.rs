//! `build-model`: from a patient's segmented CT to a model package.

fn main() {}
