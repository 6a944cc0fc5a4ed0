//! The program as its users run it.

mod adapt;
mod bad_input;
mod chain;
mod data;
mod faults;
mod help;
mod program;
mod serve;
mod settings;
mod smoke;
mod survival;
