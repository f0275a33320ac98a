//! Bodies and checks that several tests use.

pub mod track;
