/// The commented scene that `rehearse scene --example` writes: every key with its default or a usual value.
pub const EXAMPLE: &str = include_str!("example.toml");

/// The paper's protocol (`fixtures/scenes/probe-press.toml`).
pub const PROBE_PRESS: &str = include_str!("../../../../fixtures/scenes/probe-press.toml");

/// The protocol, then the probe is lifted off (`fixtures/scenes/press-and-release.toml`).
pub const PRESS_AND_RELEASE: &str = include_str!("../../../../fixtures/scenes/press-and-release.toml");

/// The protocol on tissue of finite elements (`fixtures/scenes/fem-press.toml`).
pub const FEM_PRESS: &str = include_str!("../../../../fixtures/scenes/fem-press.toml");

/// A needle through the kidney's capsule into its tumour and out again (`fixtures/scenes/kidney-biopsy.toml`).
pub const KIDNEY_BIOPSY: &str = include_str!("../../../../fixtures/scenes/kidney-biopsy.toml");
