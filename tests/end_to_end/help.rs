//! Help, completions and manual pages know every command.

use crate::program::{barchan, text};

fn said(args: &[&str]) -> String {
    let output = barchan().args(args).assert().success();
    String::from_utf8_lossy(&output.get_output().stdout).into_owned()
}

/// The commands that `barchan --help` lists.
fn commands() -> Vec<String> {
    let help = said(&["--help"]);
    let list = help.split("Commands:").nth(1).unwrap();
    let names = list.lines().skip(1).take_while(|l| !l.trim().is_empty());
    // Descriptions are wrapped further to the right.
    let names = names.filter(|l| l.starts_with("  ") && !l.starts_with("   "));
    let names = names.map(|l| l.split_whitespace().next().unwrap().to_owned());
    names.filter(|name| name != "help").collect()
}

#[test]
fn every_command_shows_two_examples() {
    let commands = commands();
    assert!(commands.len() >= 15, "{commands:?}");
    for command in commands {
        let help = said(&[&command, "--help"]);
        let examples = help.split("Examples:").nth(1).unwrap_or_default();
        let shown = examples.matches(&format!("barchan {command}")).count();
        assert!(shown >= 2, "{command}: {shown} examples");
    }
}

#[test]
fn shells_and_man_know_every_command() {
    let dir = tempfile::tempdir().unwrap();
    said(&["man", "--out", text(dir.path())]);
    let completions = ["bash", "zsh", "fish"].map(|shell| said(&["completions", shell]));
    for command in commands() {
        assert!(
            completions.iter().all(|c| c.contains(&command)),
            "{command}"
        );
        let page = dir.path().join(format!("barchan-{command}.1"));
        let page = std::fs::read_to_string(page).unwrap();
        assert!(page.contains("Examples"), "{command}");
    }
}
