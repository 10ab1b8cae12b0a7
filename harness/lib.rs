//! A research harness for multi-modal perception of a soft robot.
//!
//! The harness simulates a soft robot with MuJoCo, trains networks on its observations, and writes the results to
//! tables. Each layer is a crate that uses only the layers below it; ARCHITECTURE.md lists them. This crate re-exports
//! all layers, for programs and for the Python package, and adds the command line in [`cli`]. Start reading in
//! [`experiment`], which puts the steps of an experiment together.

// The modules of the command line use the library by its name, like any other user.
extern crate self as harness;
// These macros replace those of the standard library, which panic if a stream is full or closed.
#[macro_use]
mod terminal;

pub mod cli;

pub use harness_analysis as analysis;
pub use harness_catalog as catalog;
pub use harness_claims as claims;
pub use harness_experiment as experiment;
pub use harness_experiment::{collection, shard};
pub use harness_figures as figures;
pub use harness_judge as judge;
pub use harness_learning as learning;
pub use harness_metrics as metrics;
pub use harness_ops as ops;
pub use harness_registry as registry;
pub use harness_registry::{dataset, transfer};
pub use harness_report as report;
pub use harness_samples as samples;
pub use harness_serve as serve;
pub use harness_shared::{files, meant, memory, nearest, numbers, progress, seal};
pub use harness_simulation as simulation;
pub use harness_spec as spec;
pub use harness_sql as sql;
pub use harness_tables as tables;
pub use harness_tables::schema;
