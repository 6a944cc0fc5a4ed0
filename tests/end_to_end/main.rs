//! The program as its users run it.

mod adapt;
mod bad_input;
mod book;
mod chain;
mod data;
mod faults;
mod fusion;
mod help;
mod methods;
mod noise;
mod program;
mod serve;
mod settings;
mod smoke;
mod structured_light;
mod survival;
mod view;
