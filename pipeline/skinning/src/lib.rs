//! Makes skinning weights: up to four cluster frames per point (Camara et al. 2016, "Weighted matrix blending").
//!
//! From: points and cluster centres.
//! Refuses: no clusters; non-finite points.
