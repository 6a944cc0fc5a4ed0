//! The book in `docs/` tells the truth: its commands run, its links lead somewhere.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

fn docs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("docs")
}

fn read(file: &str) -> String {
    std::fs::read_to_string(docs().join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// Targets of the links of a page, outside its fenced blocks.
fn links(page: &str) -> Vec<String> {
    let prose = page.split("```").step_by(2);
    let links = prose.flat_map(|text| text.split("](").skip(1));
    links
        .filter_map(|l| Some(l.split_once(')')?.0.to_owned()))
        .collect()
}

/// The pages in the order of the book.
fn chapters() -> Vec<String> {
    links(&read("SUMMARY.md"))
}

/// What is inside the fenced blocks marked `sh`.
fn commands(page: &str) -> Vec<String> {
    let fenced = page.split("```").skip(1).step_by(2);
    fenced
        .filter_map(|block| Some(block.strip_prefix("sh\n")?.to_owned()))
        .collect()
}

/// The anchor that mdBook and GitHub give a headline.
fn anchor(headline: &str) -> String {
    let kept = headline.trim().chars();
    kept.filter(|c| c.is_alphanumeric() || [' ', '-', '_'].contains(c))
        .map(|c| {
            if c == ' ' {
                '-'
            } else {
                c.to_ascii_lowercase()
            }
        })
        .collect()
}

#[test]
fn commands_of_the_book_run_in_its_order() {
    let dir = tempfile::tempdir().unwrap();
    let program = Path::new(env!("CARGO_BIN_EXE_barchan"));
    let mut path = program.parent().unwrap().as_os_str().to_owned();
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    let mut ran = 0;
    for chapter in chapters() {
        for block in commands(&read(&chapter)) {
            let output = Command::new("sh")
                .args(["-e", "-c", &block])
                .env("PATH", &path)
                .current_dir(dir.path())
                .output()
                .unwrap();
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{chapter}:\n{block}\n{said}");
            ran += 1;
        }
    }
    assert!(ran >= 8, "only {ran} blocks of commands");
    for product in ["runs/s/report.html", "map/elevation.tif", "a.onnx"] {
        assert!(dir.path().join(product).is_file(), "{product}");
    }
}

#[test]
fn links_of_the_book_lead_somewhere() {
    for chapter in chapters() {
        for link in links(&read(&chapter)) {
            if link.contains("://") {
                continue;
            }
            let (file, part) = link.split_once('#').unwrap_or((&link, ""));
            let target = read(if file.is_empty() { &chapter } else { file });
            let mut headlines = target.lines().filter(|l| l.starts_with('#'));
            let found = headlines.any(|h| anchor(h.trim_start_matches('#')) == part);
            assert!(
                part.is_empty() || found,
                "{chapter}: no headline for {link}"
            );
        }
    }
}

#[test]
fn every_page_is_in_the_summary() {
    let files = std::fs::read_dir(docs()).unwrap();
    let names = files.map(|f| f.unwrap().file_name().into_string().unwrap());
    let pages: BTreeSet<String> = names
        .filter(|name| name.ends_with(".md") && name != "SUMMARY.md")
        .collect();
    assert_eq!(pages, chapters().into_iter().collect());
}
