//! Bodies and checks that several tests use.
#![allow(dead_code)]

pub mod gel;
pub mod rod;
pub mod track;
