//! The service: answers as the commands give them, limits, and an end in good order.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::program::{barchan, json, refused, rendered, text};

const FRAMES: usize = 6;
const TOKEN: &str = "0123456789abcdef0123";

struct Service {
    child: Child,
    address: String,
}

impl Service {
    /// Starts it on a free port and waits until it listens.
    fn start(data: &Path, args: &[&str]) -> Self {
        let rig = data.join("rig.toml");
        let mut child = Command::new(env!("CARGO_BIN_EXE_barchan"))
            .args("serve --json --model sgm:64 --listen 127.0.0.1:0 --rig".split(' '))
            .arg(rig)
            .args(args)
            .env_remove("BARCHAN_TOKEN")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut said = String::new();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        while !said.ends_with("}\n") {
            assert!(out.read_line(&mut said).unwrap() > 0, "it said only {said}");
        }
        let said: Value = serde_json::from_str(&said).unwrap();
        let address = said["listening"].as_str().unwrap().to_owned();
        Self { child, address }
    }

    fn ask(&self, head: &str, body: &[u8]) -> (u16, Vec<u8>) {
        ask(&self.address, head, body)
    }

    fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.ask(&format!("GET {path} HTTP/1.1\r\n"), b"")
    }

    fn get_json(&self, path: &str) -> Value {
        let (status, body) = self.get(path);
        assert_eq!(status, 200, "{path}: {}", String::from_utf8_lossy(&body));
        serde_json::from_slice(&body).unwrap()
    }

    fn metric(&self, name: &str) -> f64 {
        let (_, body) = self.get("/metrics");
        let body = String::from_utf8(body).unwrap();
        let line = body.lines().find(|l| l.starts_with(name)).unwrap();
        line.rsplit(' ').next().unwrap().parse().unwrap()
    }

    fn post(&self, fields: &[(&str, &[u8])]) -> (u16, Vec<u8>) {
        post(&self.address, fields, "")
    }

    /// Ends it as a service manager does, and demands success.
    fn stop(mut self) {
        let id = self.child.id().to_string();
        assert!(
            Command::new("kill")
                .args(["-s", "TERM", &id])
                .status()
                .unwrap()
                .success()
        );
        let deadline = Instant::now() + Duration::from_secs(60);
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                assert!(status.success(), "{status}");
                return;
            }
            assert!(Instant::now() < deadline, "it does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // Of a test that failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Status and body of the answer to a request line with headers, `Content-Length` added.
fn ask(address: &str, head: &str, body: &[u8]) -> (u16, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(60)))
        .unwrap();
    let length = body.len();
    let head = format!("{head}Connection: close\r\nContent-Length: {length}\r\n\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    // A service that refuses need not read to the end.
    let _ = stream.write_all(body);
    answer(stream)
}

fn answer(mut stream: TcpStream) -> (u16, Vec<u8>) {
    let mut bytes = vec![];
    stream.read_to_end(&mut bytes).unwrap();
    let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
    let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    let length = head.split("Content-Length: ").nth(1).unwrap();
    let length: usize = length.lines().next().unwrap().parse().unwrap();
    assert_eq!(length, bytes.len() - end - 4);
    (status, bytes[end + 4..].to_vec())
}

fn post(address: &str, fields: &[(&str, &[u8])], headers: &str) -> (u16, Vec<u8>) {
    let mut body = vec![];
    for (name, bytes) in fields {
        write!(
            body,
            "--cut\r\nContent-Disposition: form-data; name=\"{name}\"\r\n\r\n"
        )
        .unwrap();
        body.extend_from_slice(bytes);
        body.extend_from_slice(b"\r\n");
    }
    body.extend_from_slice(b"--cut--\r\n");
    let head = format!(
        "POST /pairs HTTP/1.1\r\nContent-Type: multipart/form-data; boundary=cut\r\n{headers}"
    );
    ask(address, &head, &body)
}

fn image(data: &Path, side: &str, i: usize) -> Vec<u8> {
    std::fs::read(data.join(format!("{side}/{i:06}.png"))).unwrap()
}

fn pair(data: &Path, i: usize) -> [Vec<u8>; 2] {
    ["left", "right"].map(|side| image(data, side, i))
}

fn data() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let data = rendered(dir.path(), FRAMES);
    (dir, data)
}

#[test]
fn it_answers_as_infer_slam_and_map_do() {
    let (dir, data) = data();
    let [infer, slam, runs] = ["infer", "slam", "runs"].map(|n| dir.path().join(n));
    let args = ["--model", "sgm:64", "--data", text(&data), "--no-check"];
    json(&[&["infer"], &args[..], &["--out", text(&infer)]].concat());
    // The service is sent images alone, and waits for the map before it answers. What it answers comes
    // before the whole map is adjusted, what it records after that.
    let waiting = dir.path().join("waiting.toml");
    let live = dir.path().join("live");
    std::fs::write(&waiting, "map_lag = 0\nadjust_all = false\n").unwrap();
    let alike = [
        "--no-fusion",
        "--config",
        text(&waiting),
        "--out",
        text(&live),
    ];
    json(&[&["slam"], &args[..], &alike].concat());
    std::fs::write(&waiting, "map_lag = 0\n").unwrap();
    let alike = [
        "--no-fusion",
        "--config",
        text(&waiting),
        "--out",
        text(&slam),
    ];
    json(&[&["slam"], &args[..], &alike].concat());
    let times = std::fs::read_to_string(data.join("times.txt")).unwrap();
    let times: Vec<&str> = times.lines().collect();
    let service = Service::start(&data, &["--runs", text(&runs)]);
    for i in 0..FRAMES {
        let [left, right] = pair(&data, i);
        let fields = [
            ("left", &left[..]),
            ("right", &right),
            ("time", times[i].as_bytes()),
        ];
        let (status, body) = service.post(&fields);
        assert_eq!(status, 200, "{}", String::from_utf8_lossy(&body));
        let told: Value = serde_json::from_slice(&body).unwrap();
        assert_eq!(told["pair"], i);
        assert!(told["track"]["tracked"].as_bool().unwrap(), "{told}");
        for (product, file) in [
            ("disparity.png", format!("disparity/{i:06}.png")),
            ("disparity.pfm", format!("disparity/{i:06}.pfm")),
            ("confidence.png", format!("confidence/{i:06}.png")),
        ] {
            let (status, bytes) = service.get(told["products"][product].as_str().unwrap());
            assert_eq!(status, 200);
            assert!(
                bytes == std::fs::read(infer.join(&file)).unwrap(),
                "{file} is another"
            );
        }
    }
    // The pose of the newest pair is the last line of what `slam` wrote.
    let told = service.get_json("/pairs/latest");
    let line = std::fs::read_to_string(live.join("trajectory.kitti")).unwrap();
    let expected: Vec<f64> = (line.lines().last().unwrap().split(' '))
        .map(|n| n.parse().unwrap())
        .collect();
    let rows = told["track"]["T_world_cam"].as_array().unwrap();
    let found = rows.iter().flat_map(|r| r.as_array().unwrap());
    for (a, b) in found.map(|n| n.as_f64().unwrap()).zip(expected) {
        assert!((a - b).abs() < 1e-6, "{told}");
    }
    // Tiles cover the map, and hold elevation.
    let map = service.get_json("/map");
    let range = |name: &str| {
        let [first, last] = [0, 1].map(|k| map[name][k].as_i64().unwrap());
        first..=last
    };
    let mut known = 0;
    for column in range("columns") {
        for row in range("rows") {
            let (status, bytes) = service.get(&format!("/map/{column}/{row}.png"));
            assert_eq!(status, 200);
            let shaded = image::load_from_memory(&bytes).unwrap().into_luma8();
            known += shaded.iter().filter(|v| **v > 0).count();
            let (status, bytes) = service.get(&format!("/map/{column}/{row}.tif"));
            assert_eq!((status, &bytes[..2]), (200, &b"II"[..]));
        }
    }
    assert!(known > 300, "{known} cells");
    assert_eq!(service.get("/map/9999/0.tif").0, 404);
    assert_eq!(service.get("/pairs/77").0, 404);
    assert_eq!(service.metric("barchan_pairs_total"), FRAMES as f64);
    service.stop();
    // What it recorded is a run as any, and its poses are those of `slam`.
    let run = runs.join("run-000001");
    for file in ["trajectory.tum", "keyframes.tum", "covariance.csv"] {
        let [a, b] = [&run, &slam].map(|r| std::fs::read_to_string(r.join(file)).unwrap());
        assert!(a == b, "{file} is another:\n{a}\n{b}");
    }
    json(&["map", text(&run), "--out", text(&dir.path().join("map"))]);
}

#[test]
fn what_is_no_pair_is_refused_in_plain_words() {
    let (_dir, data) = data();
    let service = Service::start(&data, &["--max-body", "1", "--max-rate", "1000"]);
    let [left, right] = pair(&data, 0);
    let refused = |answer: (u16, Vec<u8>), status: u16, word: &str| {
        let message = String::from_utf8_lossy(&answer.1).into_owned();
        assert_eq!(answer.0, status, "{message}");
        assert!(message.contains(word), "\"{word}\" is not in: {message}");
    };
    let half = &left[..left.len() / 2];
    refused(
        service.post(&[("left", half), ("right", &right)]),
        422,
        "left",
    );
    refused(
        service.post(&[("left", b"no image"), ("right", &right)]),
        422,
        "not an image",
    );
    refused(service.post(&[("left", &left)]), 400, "there is no right");
    refused(
        service.post(&[("left", &left), ("right", &right), ("time", b"soon")]),
        400,
        "soon",
    );
    refused(
        service.post(&[("left", &left), ("right", &right), ("name", b"a,b")]),
        400,
        "name",
    );
    // A bomb: a header that claims 50 000 x 50 000 pixels.
    let mut bomb = left.clone();
    bomb[16..24].copy_from_slice(&[0, 0, 0xc3, 0x50, 0, 0, 0xc3, 0x50]);
    refused(
        service.post(&[("left", &bomb), ("right", &right)]),
        422,
        "left",
    );
    let large = vec![0; 3 << 20];
    refused(
        service.post(&[("left", &large), ("right", &right)]),
        413,
        "--max-body",
    );
    let plain = "POST /pairs HTTP/1.1\r\nContent-Type: text/plain\r\n";
    refused(service.ask(plain, b"hello"), 415, "curl");
    let form = "POST /pairs HTTP/1.1\r\nContent-Type: multipart/form-data; boundary=x\r\n";
    refused(service.ask(form, b"--x\r\nnothing"), 400, "form");
    refused(service.get("/../../etc/passwd"), 404, "no such thing");
    refused(service.get("/pairs"), 405, "POST");
    refused(
        service.ask("GET / HTTP/1.1\r\nOrigin: http://a.example\r\n", b""),
        403,
        "browser",
    );
    // A length that nothing could hold is refused before anything is taken for it.
    let mut stream = TcpStream::connect(&service.address).unwrap();
    let head = b"POST /pairs HTTP/1.1\r\nContent-Length: 18446744073709551615\r\n\r\n";
    stream.write_all(head).unwrap();
    stream.shutdown(Shutdown::Write).unwrap();
    refused(answer(stream), 413, "18446744073709551615");
    for garbage in [
        &b"\x16\x03\x01\x02\x00"[..],
        b"GET\r\n\r\n",
        &[b'a'; 40_000],
    ] {
        let mut stream = TcpStream::connect(&service.address).unwrap();
        let _ = stream.write_all(garbage);
        let _ = stream.shutdown(Shutdown::Write);
        let mut bytes = vec![];
        let _ = stream.read_to_end(&mut bytes);
        assert!(
            bytes.is_empty() || bytes.starts_with(b"HTTP/1.1 4"),
            "{bytes:?}"
        );
    }
    // After all that it works, and time does not run backwards.
    let timed = |time: &[u8]| service.post(&[("left", &left), ("right", &right), ("time", time)]);
    assert_eq!(timed(b"10").0, 200);
    refused(timed(b"9.5"), 422, "9.5");
    assert_eq!(service.get_json("/health")["status"], "ok");
    service.stop();
}

#[test]
fn beyond_this_machine_a_token_is_needed() {
    let (dir, data) = data();
    let rig = data.join("rig.toml");
    let anywhere = [
        "serve",
        "--model",
        "sgm:64",
        "--rig",
        text(&rig),
        "--listen",
        "0.0.0.0:0",
    ];
    let message = refused(&anywhere);
    assert!(
        message.contains("--token-file") && message.contains("0.0.0.0"),
        "{message}"
    );
    let file = dir.path().join("token");
    std::fs::write(&file, "short\n").unwrap();
    let message = refused(&[&anywhere[..], &["--token-file", text(&file)]].concat());
    assert!(message.contains("16 characters"), "{message}");

    std::fs::write(&file, format!("{TOKEN}\n")).unwrap();
    let service = Service::start(&data, &["--token-file", text(&file)]);
    let [left, right] = pair(&data, 0);
    let fields = [("left", &left[..]), ("right", &right[..])];
    for wrong in [
        "",
        "Authorization: Bearer 0123456789abcdef0124\r\n",
        "Authorization: Bearer \r\n",
    ] {
        assert_eq!(post(&service.address, &fields, wrong).0, 401, "{wrong}");
    }
    assert_eq!(service.get("/metrics").0, 401);
    assert_eq!(service.get("/health").0, 200);
    let right_one = format!("Authorization: Bearer {TOKEN}\r\n");
    assert_eq!(post(&service.address, &fields, &right_one).0, 200);
    service.stop();
}

#[test]
fn more_than_the_rate_is_refused_and_many_clients_are_answered() {
    let (_dir, data) = data();
    let service = Service::start(&data, &["--max-rate", "0.001", "--no-track"]);
    let [left, right] = pair(&data, 0);
    let fields = [("left", &left[..]), ("right", &right[..])];
    assert_eq!(service.post(&fields).0, 200);
    let (status, message) = service.post(&fields);
    assert_eq!(status, 429);
    assert!(String::from_utf8_lossy(&message).contains("--max-rate"));
    service.stop();

    let service = Service::start(
        &data,
        &["--max-rate", "1000", "--no-track", "--keep-answers", "40"],
    );
    let clients: Vec<_> = (0..8)
        .map(|client| {
            let (address, data) = (service.address.clone(), data.clone());
            std::thread::spawn(move || {
                let answers = (0..4).map(|i| {
                    let [left, right] = pair(&data, (client + i) % FRAMES);
                    let (status, body) = post(&address, &[("left", &left), ("right", &right)], "");
                    assert_eq!(status, 200);
                    let told: Value = serde_json::from_slice(&body).unwrap();
                    (told["pair"].as_u64().unwrap(), (client + i) % FRAMES)
                });
                answers.collect::<Vec<_>>()
            })
        })
        .collect();
    let mut answers: Vec<_> = clients
        .into_iter()
        .flat_map(|c| c.join().unwrap())
        .collect();
    answers.sort_unstable();
    let numbers: Vec<u64> = answers.iter().map(|a| a.0).collect();
    assert_eq!(numbers, (0..32).collect::<Vec<_>>());
    // Nobody got the answer of another: one image, one disparity, whoever sent it.
    let disparity = |number| service.get(&format!("/pairs/{number}/disparity.pfm")).1;
    for frame in 0..FRAMES {
        let mut of_frame = answers
            .iter()
            .filter(|a| a.1 == frame)
            .map(|a| disparity(a.0));
        let first = of_frame.next().unwrap();
        assert!(of_frame.all(|d| d == first), "frame {frame}");
    }
    service.stop();
}

#[test]
fn a_watched_folder_is_emptied_into_a_ring_of_runs() {
    let (dir, data) = data();
    let [watched, runs] = ["camera", "runs"].map(|n| dir.path().join(n));
    for side in ["left", "right"] {
        std::fs::create_dir_all(watched.join(side)).unwrap();
    }
    // What is not the ring's is left alone; what a killed service left half is not.
    std::fs::create_dir_all(runs.join("run-mine")).unwrap();
    std::fs::create_dir_all(runs.join("run-000041.part")).unwrap();
    let config = dir.path().join("rover.toml");
    let settings = "keep_runs = 2\nframes_per_run = 2\nconsume = true\nruns = \"runs\"\nwatch = \"camera\"\n[slam]\nfeatures = 600\n";
    std::fs::write(&config, settings).unwrap();
    let service = Service::start(&data, &["--config", text(&config)]);
    for i in 0..FRAMES {
        for side in ["left", "right"] {
            // Under another name first, as a camera should.
            let part = watched.join(side).join(format!("{i:06}.png.part"));
            std::fs::write(&part, image(&data, side, i)).unwrap();
            std::fs::rename(&part, watched.join(side).join(format!("{i:06}.png"))).unwrap();
        }
    }
    let deadline = Instant::now() + Duration::from_secs(60);
    while service.metric("barchan_runs_written_total") < 3.0 {
        assert!(Instant::now() < deadline, "no third run");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(service.get_json("/pairs/latest")["name"], "000005");
    service.stop();
    let mut left: Vec<_> = (runs.read_dir().unwrap())
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    left.sort();
    assert_eq!(left, ["run-000002", "run-000003", "run-mine"]);
    for side in ["left", "right"] {
        assert_eq!(watched.join(side).read_dir().unwrap().count(), 0);
    }
    let config = std::fs::read_to_string(runs.join("run-000003/config.toml")).unwrap();
    assert!(config.contains("features = 600"), "{config}");
}

#[test]
fn settings_that_make_no_sense_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("rover.toml");
    for (line, word) in [
        ("max_rate = 0.0", "max_rate"),
        ("keep_runs = 0", "keep_runs"),
        ("colour = 1", "colour"),
    ] {
        std::fs::write(&config, line).unwrap();
        let message = refused(&["serve", "--config", text(&config)]);
        assert!(message.contains(word), "{message}");
    }
    barchan().args(["serve", "--help"]).assert().success();
}
