//! What strict IEC 61131-3 compilers demand of `config/plc.st`, as a lint: none of them can be had here.

use std::collections::HashSet;

/// Words of the language that no name may be.
const KEYWORDS: &[&str] = &[
    "ARRAY", "AND", "BOOL", "BY", "CASE", "DINT", "DO", "ELSE", "ELSIF", "EXIT", "FALSE", "FOR",
    "IF", "INT", "MOD", "NOT", "OF", "ON", "OR", "PROGRAM", "REAL", "REPEAT", "RETAIN", "RETURN",
    "STRUCT", "THEN", "TIME", "DATE", "TO", "TRUE", "TYPE", "UDINT", "UINT", "UNTIL", "VAR",
    "WHILE", "WITH", "XOR",
];
const ELEMENTARY: &[&str] = &["BOOL", "INT", "UINT", "DINT", "UDINT", "REAL"];

fn source() -> String {
    let path = format!("{}/config/plc.st", env!("CARGO_MANIFEST_DIR"));
    std::fs::read_to_string(path).expect("committed")
}

/// Complaints about a source, each with its line.
fn lint(source: &str) -> Vec<String> {
    let mut complaints = Vec::new();
    let mut types: HashSet<String> = ELEMENTARY.iter().map(ToString::to_string).collect();
    let mut declared: HashSet<String> = HashSet::new();
    let mut open: Vec<&str> = Vec::new();
    let mut in_comment = false;
    let bare: Vec<String> =
        source.lines().map(|line| without_comments(line, &mut in_comment)).collect();
    for (number, line) in bare.iter().enumerate() {
        let code = line.trim();
        let mut complain =
            |what: &str| complaints.push(format!("line {}: {what}: {code}", number + 1));
        if code.matches('(').count() != code.matches(')').count() {
            complain("brackets do not match");
        }
        let words: Vec<&str> = code
            .split(|c: char| !c.is_alphanumeric() && c != '_')
            .filter(|w| !w.is_empty())
            .collect();
        let Some(&first) = words.first() else { continue };
        let declares = open.iter().any(|o| o.starts_with("VAR") || *o == "STRUCT");
        match first {
            "TYPE" => {
                open.push("TYPE");
                types.insert(words[1].to_owned());
                if code.contains("ARRAY") && !code.ends_with(';') {
                    complain("`;` is missing");
                }
            }
            "STRUCT" | "VAR" | "VAR_INPUT" | "VAR_OUTPUT" => open.push(first),
            "FUNCTION_BLOCK" => {
                open.push(first);
                types.insert(words[1].to_owned());
                declared.clear();
            }
            "IF" | "FOR" => {
                open.push(first);
                if !code.ends_with(if first == "IF" { "THEN" } else { "DO" }) {
                    complain("no THEN or DO");
                }
                names(code, &declared, &mut complain);
            }
            end if end.starts_with("END_") => {
                let began = open.pop().unwrap_or("nothing");
                if !began.starts_with(&end["END_".len()..]) {
                    complain(&format!("ends a {began}"));
                }
                let with_semicolon = ["END_STRUCT", "END_IF", "END_FOR"].contains(&end);
                if with_semicolon != code.ends_with(';') {
                    complain("`;` is missing, or too much");
                }
            }
            name if declares => {
                if !code.ends_with(';') {
                    complain("`;` is missing");
                }
                if code.contains("ARRAY") {
                    complain("an anonymous array is a type of its own");
                }
                if !words.get(1).is_some_and(|kind| types.contains(*kind)) {
                    complain("a type that is not declared before");
                }
                if KEYWORDS.contains(&name.to_uppercase().as_str()) {
                    complain("a key word as name");
                }
                if open.last() != Some(&"STRUCT") && !declared.insert(name.to_owned()) {
                    complain("declared twice");
                }
            }
            _ => {
                if !code.ends_with(';') {
                    complain("`;` is missing");
                }
                names(code, &declared, &mut complain);
            }
        }
    }
    if !open.is_empty() {
        complaints.push(format!("not ended: {open:?}"));
    }
    complaints
}

/// Every name of a statement that no member, function or parameter is must be declared.
fn names(code: &str, declared: &HashSet<String>, complain: &mut impl FnMut(&str)) {
    let mut before = ' ';
    for word in code.split_inclusive(|c: char| !c.is_alphanumeric() && c != '_') {
        let after = word.chars().last().unwrap_or(' ');
        let name = word.trim_end_matches(|c: char| !c.is_alphanumeric() && c != '_');
        let is_conversion = name.contains("_TO_");
        let is_number = name.starts_with(|c: char| c.is_ascii_digit());
        let known = KEYWORDS.contains(&name) || declared.contains(name);
        if !name.is_empty() && before != '.' && !is_number && !is_conversion && !known {
            complain(&format!("{name} is not declared"));
        }
        before = after;
    }
}

fn without_comments(line: &str, in_comment: &mut bool) -> String {
    let (mut code, mut rest) = (String::new(), line);
    loop {
        if *in_comment {
            let Some(end) = rest.find("*)") else { return code };
            (rest, *in_comment) = (&rest[end + 2..], false);
        } else {
            let Some(start) = rest.find("(*") else { return code + rest };
            code += &rest[..start];
            (rest, *in_comment) = (&rest[start + 2..], true);
        }
    }
}

#[test]
fn strict_compilers_take_the_structured_text() {
    let complaints = lint(&source());
    assert!(complaints.is_empty(), "{complaints:#?}");
}

#[test]
fn the_lint_sees_what_strict_compilers_refuse() {
    let source = source();
    for (right, wrong) in [
        ("END_STRUCT;", "END_STRUCT"),
        ("END_IF;", "END_IF"),
        ("    block : BeltgaugeBlock;", "    block : ARRAY[0..31] OF UINT;"),
        ("    block : BeltgaugeBlock;", "    block : BeltgaugeBlok;"),
        ("known := FALSE;", "known := FALSE"),
        ("known := FALSE;", "knwon := FALSE;"),
        ("    known : BOOL;", "    time : BOOL;"),
        ("END_TYPE", ""),
        ("(NOT known)", "(NOT known"),
    ] {
        assert!(source.contains(right), "{right}");
        let complaints = lint(&source.replacen(right, wrong, 1));
        assert!(!complaints.is_empty(), "{wrong} passes");
    }
}
