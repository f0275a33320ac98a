//! Reads, writes, validates and exports model packages: the one file that a rehearsal loads.
//!
//! Refuses: damaged or incomplete files, arrays that break what the runtime relies on, newer schemas.
