//! The page against the demo, in a real browser. Screenshots are in `target/hil-out/web`.

use hil::Demo;
use hil::browser::Browser;
use serde_json::Value;

/// A thing on the page that is there and shows something.
const TEXT: &str = "return document.querySelector('main').innerText.length > 50";

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
            return /\\b(page|lamp|parcel|plc|event|figure|live|reason)\\.[a-z_0-9]+/.exec(page.textContent)?.[0] ?? null";
        assert_eq!(browser.run(key).await, Value::Null, "a text is missing on {name}");
    }
    let registers = "return document.querySelector('main').innerText.includes('sigma_length')";
    browser.run("location.hash = '#plc'").await;
    browser.wait("registers", registers).await;

    // One parcel, opened by its button and closed by the key that dialogs have.
    browser.run("location.hash = '#parcels'").await;
    browser.wait("a parcel", "return document.querySelector('td button.link') !== null").await;
    browser.run("document.querySelector('td button.link').click()").await;
    browser.wait("its page", "return document.getElementById('dialog').open").await;
    browser.screenshot(&shot("parcel")).await;
    browser.run("document.querySelector('#dialog button').click()").await;

    // Older ones come from the archive.
    browser.run("[...document.querySelectorAll('main button')].at(-1).click()").await;
    let archived = "return [...document.querySelectorAll('img')].some((image) => image.src.includes('/api/archive/') )";
    browser.wait("the archive", archived).await;

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
