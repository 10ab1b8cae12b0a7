//! A research harness for multi-modal perception of a soft robot.
//!
//! Data flows one way, and each room may use only those before it:
//! spec, simulation, dataset, learning, metrics, registry. The story of an experiment is in [`experiment`];
//! [`analysis`] says which of its runs form a result, [`claims`] are judged by its results, [`figures`] drawn of them, and a [`report`] tells it all. [`cli`] is the program,
//! for its binary and for Python.

// The command line names the library as any other user does.
extern crate self as harness;

pub mod analysis;
pub mod claims;
pub mod cli;
pub mod dataset;
pub mod experiment;
pub mod figures;
pub mod files;
pub mod learning;
pub mod memory;
pub mod metrics;
pub mod numbers;
pub mod progress;
pub mod registry;
pub mod report;
pub mod schema;
pub mod seal;
pub mod simulation;
pub mod spec;
pub mod tables;
