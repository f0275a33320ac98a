# What CI checks, in its order.
check: test fmt clippy doc

# The README's test command.
test:
    cargo test --release --workspace

fmt:
    cargo fmt --all -- --check

clippy:
    cargo clippy --release --workspace --all-targets -- -D warnings

doc:
    RUSTDOCFLAGS="-D warnings" cargo doc --release --workspace --no-deps

# The bundled phantom: a package, a report and a press to look at in out/.
demo:
    cargo run --release --bin build-model -- fixtures/files/kidney-labels.nii.gz --ct fixtures/files/kidney-ct.nii.gz --labels fixtures/files/labels.txt --organ kidney --structure tumour --support cradle -o out/kidney.palpate --report out/report
    cargo run --release --bin rehearse -- run fixtures/scenes/probe-press.toml --package out/kidney.palpate -o out/press

# Every real case with default settings; prints the table of docs/benchmarks.md. Needs PALPATE_DATA.
soak:
    cargo build --release --bin build-model
    cargo run --release -p palpate-tests --bin soak

# Rewrites the golden records after a wanted change.
update-golden:
    PALPATE_UPDATE_GOLDEN=1 cargo test --release -p palpate-tests

# The same, each case three times, best time kept.
bench:
    cargo build --release --bin build-model
    cargo run --release -p palpate-tests --bin soak -- --repeat 3

# Particle and cluster counts of a real kidney at the paper's five radii. Needs PALPATE_DATA.
radii:
    cargo build --release --bin build-model
    cargo run --release -p palpate-tests --bin soak -- --radii
