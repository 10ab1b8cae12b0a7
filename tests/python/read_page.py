"""Reads a page of `harness report` in a real headless Chromium, as a person would: chooses, points, types, plays.

    read_page.py PAGE RESULTS CHROMIUM CHROMEDRIVER [--hostile | --quiet] [--screenshots DIR]

RESULTS is the folder that the page was made of; what the page shows is compared with its tables, read by pandas.
With --hostile, names on the page try to run scripts that set `window.hostile`, and only that is looked at. With --quiet,
only whether the page asks for anything, while the browser shows a page of its own beside it. Ends with an error at the
first thing that is not as it should be.
"""

import argparse
import base64
import json
import re
import tempfile
import time
from pathlib import Path

import pandas as pd
from scipy.stats import t as student
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

DESKTOP = (1280, 900)
PHONE = (360, 740)
SECTIONS = ["scenes", "claims", "readings", "joints", "regression", "figures", "training", "runs"]


def open_browser(chromium: str, driver: str, profile: str) -> webdriver.Chrome:
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
                     "--disable-background-networking", "--disable-component-update", "--disable-sync",
                     "--disable-dev-shm-usage", "--hide-scrollbars", f"--user-data-dir={profile}"]:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    # The first tab is the browser's, which loads what it likes there.
    browser.switch_to.new_window("tab")
    return browser


class Page:
    """The page in the browser."""

    def __init__(self, browser: webdriver.Chrome, path: Path, screenshots: Path | None):
        self.browser, self.path, self.screenshots = browser, path, screenshots
        self.browsers_tab = browser.window_handles[0]

    def open(self, size: tuple[int, int], dark: bool = False):
        width, height = size
        phone = size == PHONE
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": width, "height": height, "deviceScaleFactor": 2 if phone else 1, "mobile": phone})
        # Whoever wants no motion gets no smooth scrolling, under which a click would miss.
        features = {"prefers-color-scheme": "dark" if dark else "light", "prefers-reduced-motion": "reduce"}
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {
            "features": [{"name": name, "value": value} for name, value in features.items()]})
        # What the browser itself loaded before is none of the page's.
        self.browser.get_log("performance")
        self.browser.get(self.path.as_uri())

    def run(self, script: str, *arguments):
        return self.browser.execute_script(script, *arguments)

    def one(self, selector: str):
        return self.browser.find_element(By.CSS_SELECTOR, selector)

    def all(self, selector: str):
        return self.browser.find_elements(By.CSS_SELECTOR, selector)

    def select(self, section: str, label: str) -> Select:
        place = f"//section[@id='{section}']//label[starts-with(normalize-space(.), '{label}')]/select"
        return Select(self.browser.find_element(By.XPATH, place))

    def choose(self, section: str, label: str, value):
        self.select(section, label).select_by_value(str(value))

    def marks(self, section: str):
        return self.all(f"#{section} .plot .mark")

    def tooltip(self, section: str) -> str:
        return self.one(f"#{section} .tooltip").text

    def point_at(self, element):
        self.run("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", element)
        ActionChains(self.browser, duration=20).move_to_element(element).perform()

    def point_at_any(self, section: str, marks: str, name: str) -> str:
        """The tooltip of the first of these marks that no other series' mark covers."""
        heard = []
        for mark in self.all(f"#{section} {marks}"):
            self.point_at(mark)
            heard.append(self.tooltip(section))
            if heard[-1].startswith(name):
                return heard[-1]
        raise AssertionError(f"none of the tooltips begins with {name!r}: {heard}")

    def shoot(self, name: str, selector: str | None = None):
        """Saves a picture of the whole page, of one element, or of what the window shows."""
        if not self.screenshots:
            return
        if selector == "window":
            self.browser.save_screenshot(str(self.screenshots / f"{name}.png"))
            return
        target = "document.documentElement" if selector is None else f"document.querySelector('{selector}')"
        box = self.run(f"const b = {target}.getBoundingClientRect();"
                       "return {x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height}")
        clip = {**box, "scale": 1}
        picture = self.browser.execute_cdp_cmd("Page.captureScreenshot", {
            "format": "png", "clip": clip, "captureBeyondViewport": True})
        self.screenshots.joinpath(f"{name}.png").write_bytes(base64.b64decode(picture["data"]))

    def check_quiet(self):
        """No script failed, nothing was refused, and nothing was asked of any network."""
        complaints = [entry for entry in self.browser.get_log("browser") if entry["level"] != "DEBUG"]
        assert not complaints, complaints
        for entry in map(json.loads, (entry["message"] for entry in self.browser.get_log("performance"))):
            message = entry["message"]
            if entry["webview"] != self.browsers_tab and message["method"] == "Network.requestWillBeSent":
                url = message["params"]["request"]["url"]
                assert url.split(":")[0] in ("file", "data"), url


def table(results: Path, name: str) -> pd.DataFrame:
    return pd.concat(pd.read_parquet(path) for path in sorted(results.glob(f"runs/*/*/{name}.parquet")))


def number(text: str) -> float:
    return float(text.replace("\u2212", "-"))


def check_joints(page: Page, metrics: pd.DataFrame):
    """Every choice is there, and what a point says is what the tables have."""
    rows = metrics[(metrics.experiment == "single_to_multi") & (metrics.task == "prediction")
                   & (metrics.model == "network")]
    latents = sorted(rows.latent.unique())
    for scenario in ["empty", "cluttered"]:
        for latent in latents[:2]:
            for modality, metric in [("proprioception", "r2"), ("contact_force", "mae")]:
                for label, value in [("Of", modality), ("Metric", metric), ("Scenario", scenario), ("Latent", latent)]:
                    page.choose("joints", label, value)
                said = page.point_at_any("joints", ".series.first .mark", "from proprioception, ")
                joint = int(re.search(rf"(?:joint|link) (\d+), latent size {latent}\n", said)[1])
                values = rows[(rows.scenario == scenario) & (rows.latent == latent) & (rows.modality == modality)
                              & (rows.metric == metric) & (rows["index"] == joint)].value
                words = {"r2": "R²", "mae": "MAE"}[metric]
                shown = re.search(rf"{words} (\S+)(?: \[(\S+), (\S+)\])?", said)
                assert abs(number(shown[1]) - values.mean()) <= 1e-3 * abs(values.mean()), (said, values.mean())
                if len(values) > 1:
                    half = student.ppf(0.975, len(values) - 1) * values.sem()
                    low, high = number(shown[2]), number(shown[3])
                    assert abs((high - low) / 2 - half) <= 2e-3 * max(half, abs(values.mean())), (said, half)
                    assert f"over {len(values)} seeds" in said, said

    page.shoot("desktop-pointed", "window")
    names = [entry.text for entry in page.all("#joints .legend li")]
    # A line for each direction.
    assert 2 * len(names) == 2 * len(set(names)) == len(page.all("#joints .plot .line")), names
    both = len(page.marks("joints"))
    page.choose("joints", "Direction", "fe")
    assert 0 < len(page.marks("joints")) < both
    page.choose("joints", "Direction", "both")
    page.choose("joints", "Over", "latent")
    assert not page.one("#joints .choices label:last-child").is_displayed(), "the axis shows every latent size"
    shown = [text.text for text in page.all("#joints .plot text")]
    assert all(str(latent) in shown for latent in latents), shown
    page.choose("joints", "Over", "joint")


def check_keys(page: Page):
    """The arrow keys go from point to point, and Escape leaves."""
    plot = page.one("#joints .plot svg")
    plot.send_keys(Keys.ARROW_RIGHT)
    first = page.tooltip("joints")
    plot.send_keys(Keys.ARROW_RIGHT)
    second = page.tooltip("joints")
    plot.send_keys(Keys.ARROW_DOWN)
    third = page.tooltip("joints")
    assert first and second and third and len({first, second, third}) == 3, (first, second, third)
    plot.send_keys(Keys.ESCAPE)
    assert page.tooltip("joints") == ""


def check_regression(page: Page, predictions: pd.DataFrame):
    """A dot is a row of the predictions table."""
    page.choose("regression", "Of", "contact_force")
    page.choose("regression", "Direction", "aa")
    latent = int(page.select("regression", "Latent").options[0].get_attribute("value"))
    page.choose("regression", "Latent", latent)
    study = page.select("regression", "Predicted").first_selected_option.get_attribute("value")
    scenario = page.select("regression", "Scenario").first_selected_option.get_attribute("value")
    marks = page.marks("regression")
    page.point_at(marks[len(marks) // 2])
    said = page.tooltip("regression")
    reference, predicted = (number(re.search(rf"{word} (\S+) N", said)[1]) for word in ["reference", "predicted"])
    episode, sample, seed = map(int, re.search(r"episode (\d+), sample (\d+), seed (\d+)", said).groups())
    row = predictions[(predictions.experiment == study) & (predictions.scenario == scenario)
                      & (predictions.latent == latent) & (predictions.task == "prediction")
                      & (predictions.modality == "contact_force") & (predictions["index"] == 19)
                      & (predictions.seed == seed) & (predictions.episode == episode) & (predictions["sample"] == sample)]
    assert len(row) == 1, said
    for shown, stored in [(reference, row.reference.item()), (predicted, row.predicted.item())]:
        assert abs(shown - stored) <= 1e-3 * abs(stored) + 1e-9, (said, stored)


def check_training(page: Page, epochs: pd.DataFrame):
    """Each term has a chart with the table's values, and says how far it still fell at the end."""
    run = page.select("training", "Run").first_selected_option.get_attribute("value")
    stored = epochs[(epochs.run == run) & (epochs.task == "prediction") & (epochs.split == "train")]
    terms = [chart.get_attribute("data-term") for chart in page.all("#training figure")]
    assert sorted(terms) == sorted(stored.term.unique()) and (terms[0], terms[-1]) == ("total", "kl"), terms
    chart = page.one("#training figure[data-term=kl]")
    values = [stored[(stored.term == "kl") & (stored.epoch == epoch)].value.item() for epoch in [1, 2]]
    chart.find_element(By.CSS_SELECTOR, ".plot svg").send_keys(Keys.ARROW_RIGHT)
    said = chart.find_element(By.CSS_SELECTOR, ".tooltip").text
    assert said.splitlines()[0] == "training" and run in said, said
    assert abs(number(re.search(r"epoch 1: (\S+)", said)[1]) - values[0]) <= 1e-3 * abs(values[0]), (said, values)
    # Of two epochs, the last tenth is the second.
    said = chart.find_element(By.CSS_SELECTOR, ".aside").text
    change = number(re.search(r"training \S+ \(([+\u2212]?[\d.]+) %\)", said)[1])
    assert abs(change - 100 * (values[1] / values[0] - 1)) <= 0.1, (said, values)
    for scale in ["linear", "logarithmic"]:
        page.choose("training", "Scale", scale)
        lines = page.all("#training figure .plot .chosen .line")
        assert len(lines) == 2 * len(terms) and all(line.get_attribute("d") for line in lines), (scale, len(lines))


def check_missing_losses(page: Page):
    """Epochs without a loss are left out of the means at the end."""
    before, rest = page.path.read_text().split('id="data">', 1)
    text, after = rest.split("</script>", 1)
    data = json.loads(text)
    for run in data["training"]:
        run["epochs"] = list(range(1, 21))
        for splits in run["terms"].values():
            # Without the missing ones, the mean of the last tenth is 3, and that of the tenth before is 4.
            splits["train"] = 16 * [9] + [4, None, None, 3]
            splits["validation"] = 18 * [9] + [None, None]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "report.html")
        copy.write_text(f'{before}id="data">{json.dumps(data)}</script>{after}')
        altered = Page(page.browser, copy, None)
        altered.open(DESKTOP)
        said = altered.one("#training figure[data-term=kl] .aside").text
    assert "training 3 (\u221225.0 %)" in said and "validation has no value" in said, said


def check_clip(page: Page):
    picture, button = page.one(".clip img"), page.one(".clip button")
    before = picture.get_attribute("src")
    button.click()
    assert button.text == "Pause"
    deadline = time.monotonic() + 20
    while picture.get_attribute("src") == before:
        assert time.monotonic() < deadline, "the clip does not play"
    button.click()
    still = picture.get_attribute("src")
    time.sleep(0.3)
    assert button.text == "Play" and picture.get_attribute("src") == still
    assert page.run("return arguments[0].complete && arguments[0].naturalWidth > 0", picture)


def check_claims(page: Page):
    claim = page.one("details.claim")
    query = claim.find_element(By.TAG_NAME, "pre")
    assert not query.is_displayed()
    claim.find_element(By.TAG_NAME, "summary").send_keys(Keys.ENTER)
    assert query.is_displayed() and query.text.startswith("select"), query.text


def check_width(page: Page):
    """The page, with everything open, is no wider than the screen."""
    page.run("document.querySelectorAll('details').forEach((details) => (details.open = true))")
    width = page.run("return document.documentElement.scrollWidth")
    wide = page.run(
        "return [...document.querySelectorAll('body *')].filter((e) => e.getBoundingClientRect().right > innerWidth + 0.5"
        " && !e.closest('pre') && !e.closest('svg')).map((e) => e.outerHTML.slice(0, 200))")
    assert width <= page.run("return innerWidth") and not wide, (width, wide[:5])


def luminance(color: str) -> float:
    parts = [int(part) / 255 for part in re.findall(r"\d+", color)[:3]]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def check_contrast(page: Page, selector: str, least: float):
    """Text stands out from the ground by the ratio that WCAG defines."""
    colors = page.run(
        "return [getComputedStyle(document.querySelector(arguments[0])).color,"
        " getComputedStyle(document.body).backgroundColor]", selector)
    light, dark = sorted(map(luminance, colors), reverse=True)
    assert (light + 0.05) / (dark + 0.05) >= least, (selector, colors)
    return colors


def read_on_desktop(page: Page, metrics: pd.DataFrame, predictions: pd.DataFrame, epochs: pd.DataFrame):
    page.open(DESKTOP)
    for section in SECTIONS:
        assert page.one(f"#{section} h2").is_displayed(), section
        page.shoot(f"desktop-{section}", f"#{section}")
    assert len(page.all("#figures .paper > svg")) + len(page.all("#figures .absent")) == 9
    page.shoot("desktop")
    check_joints(page, metrics)
    check_keys(page)
    check_regression(page, predictions)
    page.shoot("desktop-pointed-regression", "window")
    check_training(page, epochs)
    check_clip(page)
    check_claims(page)
    check_width(page)
    check_contrast(page, "p", 7)
    page.check_quiet()


def read_on_phone(page: Page):
    page.open(PHONE)
    page.shoot("phone")
    last = page.select("joints", "Latent").options[-1].get_attribute("value")
    page.choose("joints", "Latent", last)
    page.point_at(page.marks("joints")[-1])
    assert f"latent size {last}" in page.tooltip("joints")
    page.shoot("phone-pointed", "window")
    check_width(page)
    page.shoot("phone-open")
    page.check_quiet()


def read_in_the_dark(page: Page):
    page.open(DESKTOP)
    _, light = check_contrast(page, "p", 7)
    page.open(DESKTOP, dark=True)
    _, dark = check_contrast(page, "p", 7)
    assert dark != light, "the dark has a ground of its own"
    for selector in [".verdict", ".aside", ".series", "nav a"]:
        check_contrast(page, selector, 4.5)
    page.shoot("dark")
    page.check_quiet()


def read_hostile(page: Page):
    """What is hostile stands there as text, and neither it nor an image of its own making is alive."""
    page.open(DESKTOP)
    check_width(page)
    assert page.run("return window.hostile") is None
    assert page.run("return document.querySelectorAll('img[src=x], [onerror]').length") == 0
    assert page.run("return document.scripts.length") == 2
    for section in ["claims", "training", "runs"]:
        assert "<script>window.hostile=1" in page.one(f"#{section}").get_attribute("textContent"), section
    page.check_quiet()


def read_quiet(page: Page):
    pages_tab = page.browser.current_window_handle
    page.browser.switch_to.window(page.browsers_tab)
    page.browser.get("chrome://new-tab-page/")
    page.browser.switch_to.window(pages_tab)
    page.open(DESKTOP)
    page.check_quiet()


def main():
    parser = argparse.ArgumentParser()
    for name in ["page", "results"]:
        parser.add_argument(name, type=Path)
    for name in ["chromium", "chromedriver"]:
        parser.add_argument(name)
    parser.add_argument("--hostile", action="store_true")
    parser.add_argument("--quiet", action="store_true")
    parser.add_argument("--screenshots", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as profile:
        browser = open_browser(arguments.chromium, arguments.chromedriver, profile)
        try:
            page = Page(browser, arguments.page.resolve(), arguments.screenshots)
            if arguments.hostile:
                read_hostile(page)
            elif arguments.quiet:
                read_quiet(page)
            else:
                tables = [table(arguments.results, name) for name in ["metrics", "predictions", "epochs"]]
                read_on_desktop(page, *tables)
                read_on_phone(page)
                read_in_the_dark(page)
                check_missing_losses(page)
        finally:
            browser.quit()
    print("the page reads well")


if __name__ == "__main__":
    main()
