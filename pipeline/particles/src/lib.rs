//! Makes particles and shape-matching clusters (Camara et al. 2016, "Collision and data preparation").
//!
//! From: a closed triangle mesh.
//! Refuses: open meshes; bodies too small or too thin for the chosen radius.
