//! A research harness for multi-modal perception of a soft robot.
//!
//! Each layer is a crate, and uses only those before it; ARCHITECTURE.md has the table. This crate gives them their
//! names in one place, for programs and for Python, and adds [`cli`], the program. How an experiment runs is in
//! [`experiment`].

// The command line names the library as any other user does.
extern crate self as harness;

pub mod cli;

pub use harness_analysis as analysis;
pub use harness_claims as claims;
pub use harness_collection as collection;
pub use harness_dataset as dataset;
pub use harness_experiment as experiment;
pub use harness_figures as figures;
pub use harness_learning as learning;
pub use harness_metrics as metrics;
pub use harness_registry as registry;
pub use harness_report as report;
pub use harness_shared::{files, memory, numbers, progress, seal, shard};
pub use harness_simulation as simulation;
pub use harness_spec as spec;
pub use harness_tables as tables;
pub use harness_tables::schema;
