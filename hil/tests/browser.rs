//! The page against the demo, in a real browser. Screenshots are in `target/hil-out/web`.

use hil::Demo;
use hil::browser::{BROKEN_RULES, Browser, axe};
use serde_json::{Value, json};

/// A thing on the page that is there and shows something.
const TEXT: &str = "return document.querySelector('main').innerText.length > 50";

/// Everything for somebody elsewhere.
async fn the_bundle_is_gzip(browser: &Browser) {
    browser.run("location.hash = '#events'").await;
    let bundle = "document.querySelector('a[download=\"beltgauge-bundle.tar.gz\"]')";
    browser.wait("the link", &format!("return {bundle} !== null")).await;
    let begins = format!(
        "return fetch({bundle}.href).then((answer) => answer.arrayBuffer())
            .then((file) => new DataView(file).getUint16(0))"
    );
    assert_eq!(browser.run(&begins).await, 0x1f8b, "it is gzip");
}

/// Older ones come from the archive.
async fn the_archive_s_parcels_open(browser: &Browser) {
    browser.run("[...document.querySelectorAll('main button')].at(-1).click()").await;
    let archived = "return [...document.querySelectorAll('img')].some((image) => image.src.includes('/api/archive/') )";
    browser.wait("the archive", archived).await;
    // The oldest that has a picture: what only the heights showed has none.
    let oldest =
        "[...document.querySelectorAll('tbody tr')].filter((row) => row.querySelector('img')
        ?.src.includes('/api/archive/')).at(-1).querySelector('td button.link').click()";
    browser.run(oldest).await;
    browser.run("document.querySelector('#dialog a').click()").await;
    let kept = "return location.hash.startsWith('#parcel/archive/')
        && document.querySelector('main img')?.naturalWidth > 20";
    browser.wait("a parcel of the archive", kept).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_shows_pictures_and_parcels_in_both_languages_and_its_console_is_silent() {
    let demo = Demo::start("web", 600, false);
    let browser = Browser::start([1400, 1100]).await;
    let shot = |name: &str| demo.out.join(format!("{name}.png"));
    let page = format!("http://{}/", demo.page);
    browser.client.goto(&page).await.expect("it opens");

    // Pictures arrive, one after the other, and are pictures: not all of one grey.
    let frame = "return Number(document.getElementById('live')?.dataset.frame ?? -1)";
    let first = browser
        .wait(
            "a live picture",
            "const f = document.getElementById('live')?.dataset.frame; return f ? Number(f) : null",
        )
        .await;
    let moved = format!("{frame} > {first}", first = first.as_f64().expect("a number"));
    browser.wait("the next picture", &moved).await;
    let greys = "const c = document.getElementById('live'); const d = c.getContext('2d')
        .getImageData(0, 0, c.width, c.height).data; return new Set(d).size";
    assert!(browser.run(greys).await.as_u64() > Some(50), "the picture shows nothing");

    // Parcels arrive with their pictures and cuboids.
    let parcels = "return [...document.querySelectorAll('tbody tr')].filter(
        (row) => row.querySelector('img')?.naturalWidth > 20 && row.querySelectorAll('svg path').length === 6).length > 1";
    browser.wait("parcels", parcels).await;
    browser.wait("the lamps", "return document.querySelectorAll('#lamps li').length === 4").await;
    browser.screenshot(&shot("overview")).await;

    // A hidden picture asks for nothing: the pages without one do not either.
    for name in ["parcels", "plc", "events"] {
        browser.run(&format!("location.hash = '#{name}'")).await;
        browser.wait(name, "return document.querySelectorAll('tbody tr').length > 0").await;
        browser.screenshot(&shot(name)).await;
        // What the register map says of itself names keys of the configuration.
        let key = "const page = document.body.cloneNode(true);
            page.querySelectorAll('.meaning, code').forEach((cell) => cell.remove());
            return /(?<!-)\\b(page|lamp|parcel|plc|event|bundle|figure|live|reason)\\.[a-z_0-9]+/.exec(page.textContent)?.[0] ?? null";
        assert_eq!(browser.run(key).await, Value::Null, "a text is missing on {name}");
    }
    let registers = "return document.querySelector('main').innerText.includes('sigma_length')";
    browser.run("location.hash = '#plc'").await;
    browser.wait("registers", registers).await;

    // Charts, as soon as there is something to draw, and a parcel has been told.
    browser.run("location.hash = '#trend'").await;
    let drawn = "const charts = [...document.querySelectorAll('.chart')];
        return charts.length === 6 && charts.every((chart) => chart.querySelector('canvas')?.width > 100)
            && /\\d/.test(charts[0].getAttribute('aria-label')) && /\\d/.test(charts[2].getAttribute('aria-label'))";
    browser.wait("charts", drawn).await;
    browser.screenshot(&shot("trend")).await;
    let key = "return /\\btrend\\.[a-z_]+/.exec(document.body.textContent)?.[0] ?? null";
    assert_eq!(browser.run(key).await, Value::Null, "a text is missing on trend");

    // One parcel, opened by its button and closed by the key that dialogs have.
    browser.run("location.hash = '#parcels'").await;
    browser.wait("a parcel", "return document.querySelector('td button.link') !== null").await;
    browser.run("document.querySelector('td button.link').click()").await;
    browser.wait("its page", "return document.getElementById('dialog').open").await;
    browser.screenshot(&shot("parcel")).await;
    // It has an address of its own.
    browser.run("document.querySelector('#dialog a').click()").await;
    let alone =
        "return location.hash.startsWith('#parcel/') && !document.getElementById('dialog').open
        && document.querySelector('main img')?.naturalWidth > 20";
    browser.wait("its page", alone).await;
    browser.screenshot(&shot("parcel-page")).await;
    browser.run("location.hash = '#parcel/archive/99999999'").await;
    let unknown = "return document.querySelector('main').innerText.includes('no longer known')";
    browser.wait("word that there is none", unknown).await;
    // A word that every object knows is no page.
    browser.run("location.hash = '#constructor'").await;
    browser.wait("the first page", "return document.getElementById('live') !== null").await;
    browser.run("location.hash = '#parcels'").await;

    // All of the list, for a spreadsheet.
    browser.wait("the link", "return document.querySelector('a[download]') !== null").await;
    let table =
        "return fetch(document.querySelector('a[download]').href).then((answer) => answer.text())";
    let table = browser.run(table).await;
    let lines: Vec<&str> = table.as_str().expect("text").lines().collect();
    assert!(lines[0].starts_with("n,utc,seq,length_mm,") && lines.len() > 2, "{lines:?}");

    the_bundle_is_gzip(&browser).await;
    browser.run("location.hash = '#parcels'").await;
    browser.wait("the link", "return document.querySelector('a[download]') !== null").await;

    the_archive_s_parcels_open(&browser).await;

    // German and dark.
    browser.run("document.getElementById('language').click()").await;
    // Lamps speak it with the rest, not with the next figures.
    let spoken = "if (document.querySelector('nav a').textContent !== 'Übersicht') return null;
        return document.getElementById('lamps').textContent.includes('Betrieb') ? 'all' : 'a part'";
    assert_eq!(browser.wait("German", spoken).await, "all");
    browser
        .run("document.getElementById('theme').click(); document.getElementById('theme').click()")
        .await;
    browser.run("location.hash = '#overview'").await;
    browser
        .wait("a live picture", "return document.getElementById('live')?.dataset.frame ?? null")
        .await;
    browser.wait("parcels", parcels).await;
    browser.wait("the state", "return document.querySelector('.reasons li') !== null").await;
    browser.screenshot(&shot("overview-german-dark")).await;
    assert_eq!(browser.run(TEXT).await, Value::Bool(true));

    // A tablet held upright: nothing is wider than the window.
    browser.client.set_window_size(768, 1024).await.expect("a window");
    let wide =
        "return document.documentElement.scrollWidth <= document.documentElement.clientWidth";
    browser.wait("the narrow page", wide).await;
    browser.screenshot(&shot("overview-tablet")).await;

    let console = browser.console().await;
    assert!(console.is_empty(), "{console:#?}");
    browser.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_page_keeps_the_rules_of_accessibility_and_is_reached_by_keyboard() {
    let demo = Demo::start("web-axe", 600, false);
    let browser = Browser::start([1400, 1100]).await;
    browser.client.goto(&format!("http://{}/", demo.page)).await.expect("it opens");
    browser.run(&axe()).await;
    let parcels = "return document.querySelectorAll('td button.link').length > 1";
    browser.wait("parcels", parcels).await;
    for theme in ["light", "dark"] {
        browser.run("document.getElementById('theme').click()").await;
        let shown = format!("return document.documentElement.dataset.theme === '{theme}'");
        browser.wait(theme, &shown).await;
        for name in ["overview", "parcels", "trend", "plc", "events", "setup", "site"] {
            browser.run(&format!("location.hash = '#{name}'")).await;
            let shown = "return document.querySelector('canvas, tbody tr, #site .card') !== null";
            browser.wait(name, shown).await;
            assert_eq!(browser.run(BROKEN_RULES).await, json!([]), "{name}, {theme}");
        }
        browser.run("location.hash = '#parcels'").await;
        browser.wait("parcels", parcels).await;
        browser.run("document.querySelector('td button.link').click()").await;
        browser.wait("its page", "return document.getElementById('dialog').open").await;
        assert_eq!(browser.run(BROKEN_RULES).await, json!([]), "a parcel, {theme}");
    }
    let escape = "\u{e00c}";
    browser.client.active_element().await.expect("one").send_keys(escape).await.expect("typed");
    for name in ["overview", "trend", "plc", "events", "setup"] {
        browser.run(&format!("location.hash = '#{name}'")).await;
        browser.wait(name, "return document.querySelector('canvas, tbody tr') !== null").await;
        assert_eq!(beyond_the_keyboard(&browser).await, json!([]), "{name}");
    }
    // Either would find something.
    browser.run("document.querySelector('nav a').tabIndex = -1; delete document.querySelector('nav a').dataset.reached").await;
    assert_ne!(beyond_the_keyboard(&browser).await, json!([]));
    browser.run("location.hash = '#parcels'").await;
    browser.wait("parcels", parcels).await;
    browser.run("document.querySelector('td button.link').click()").await;
    browser.wait("its page", "return document.getElementById('dialog').open").await;
    browser.run("document.querySelector('#dialog img').removeAttribute('alt')").await;
    assert_ne!(browser.run(BROKEN_RULES).await, json!([]));
    browser.end().await;
}

/// What can be clicked and is not reached by the Tab key, which goes around the page.
async fn beyond_the_keyboard(browser: &Browser) -> Value {
    let tab = "\u{e004}";
    // Rows of parcels are drawn anew while it goes around: they are left out.
    for _ in 0..40 {
        browser.client.active_element().await.expect("one").send_keys(tab).await.expect("typed");
        browser.run("document.activeElement.dataset.reached = 'yes'").await;
    }
    let left = "return [...document.querySelectorAll('a, button:not(td button), select, input')].filter(
        (one) => one.checkVisibility() && !one.disabled && !one.dataset.reached).map((one) => one.outerHTML)";
    browser.run(left).await
}

/// Every text that the machine tells begins with markup: names of cameras, sticks and interfaces, paths,
/// senders, faults come from outside.
const STRANGE_WORDS: &str = r#"
    window.strange = `"><img class="strange" src="x" onerror="document.title = 'taken'">`;
    const real = window.fetch;
    const told = (value, key) => {
        if (typeof value === 'string') return value === 'parcel' ? value : window.strange + value;
        // What is wrong with the archive is shown with its reason.
        if (key === 'reasons') return [...value, 20];
        if (Array.isArray(value)) return value.map((item) => told(item, key));
        if (value === null) return ['fault', 'damaged', 'can_interface'].includes(key) ? window.strange : null;
        if (typeof value !== 'object') return value;
        return Object.fromEntries(Object.entries(value).map(([key, value]) => [key, told(value, key)]));
    };
    window.fetch = async (path, options) => {
        const answer = await real(path, options);
        if (!path.startsWith('/api/') || path.includes('/live/')) return answer;
        return new Response(JSON.stringify(told(await answer.json())), { status: answer.status });
    };
"#;

#[tokio::test(flavor = "multi_thread")]
async fn words_from_outside_are_text_on_every_page() {
    let demo = Demo::start("web-words", 600, false);
    let browser = Browser::start([1400, 1100]).await;
    browser.client.goto(&format!("http://{}/", demo.page)).await.expect("it opens");
    browser.wait("a page", TEXT).await;
    browser.run(STRANGE_WORDS).await;
    let markup = "return document.querySelectorAll('.strange').length";
    for name in ["overview", "plc", "events"] {
        browser.run(&format!("location.hash = '#{name}'")).await;
        let told = "return document.querySelector('main').textContent.includes(window.strange)";
        browser.wait(name, told).await;
        assert_eq!(browser.run(markup).await, 0, "{name}");
    }
    browser.run("location.hash = '#parcels'").await;
    browser.wait("a parcel", "return document.querySelector('td button.link') !== null").await;
    browser.run("[...document.querySelectorAll('main button')].at(-1).click()").await;
    browser.wait("more", "return document.querySelectorAll('tbody')[1]?.children.length > 0").await;
    browser.run("document.querySelector('td button.link').click()").await;
    browser.wait("its page", "return document.getElementById('dialog').open").await;
    assert_eq!(browser.run(markup).await, 0, "parcels");

    // Had it been taken for markup, this would have shown it; and its script would not have run.
    browser.run("document.getElementById('main').innerHTML = window.strange").await;
    assert_eq!(browser.run(markup).await, 1);
    let broken = "return document.querySelector('.strange').complete";
    browser.wait("the picture that is none", broken).await;
    assert_ne!(browser.run("return document.title").await, "taken");
    let console = browser.console().await.concat();
    assert!(console.contains("Content Security Policy"), "its script was refused: {console}");
    browser.end().await;
}

/// The state stands still, as when the thread that tells it hangs; or it cannot be had.
const OLD_STATE: &str = r"
    window.real ??= window.fetch;
    let first = null;
    window.fetch = async (path, options) => {
        if (path !== '/api/state' || window.how === 'moves') return window.real(path, options);
        if (window.how === 'fails') return new Response('no', { status: 500 });
        first ??= await (await window.real(path, options)).text();
        return new Response(first);
    };
";

#[tokio::test(flavor = "multi_thread")]
async fn lamps_of_an_old_state_are_grey_and_the_page_says_so() {
    let demo = Demo::start("web-old", 600, false);
    let browser = Browser::start([1400, 1100]).await;
    browser.client.goto(&format!("http://{}/", demo.page)).await.expect("it opens");
    let lit = "return document.querySelector('#lamps .on') !== null && document.getElementById('offline').hidden";
    let grey = "return document.querySelectorAll('#lamps li').length === 4
        && document.querySelector('#lamps .on') === null && !document.getElementById('offline').hidden";
    browser.wait("lit lamps", lit).await;
    browser.run(OLD_STATE).await;
    browser.wait("grey lamps", grey).await;
    browser.screenshot(&demo.out.join("old.png")).await;
    browser.run("window.how = 'moves'").await;
    browser.wait("lit lamps again", lit).await;
    browser.run("window.how = 'fails'").await;
    browser.wait("grey lamps again", grey).await;
    browser.end().await;
}
