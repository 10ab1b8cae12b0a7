"""Uses the page of `harness serve` in a real headless Chromium, as a person would: filters, sorts, groups, chooses, asks.

    use_serve.py HARNESS RESULTS CHROMIUM CHROMEDRIVER [--hostile] [--many] [--live SPEC] [--screenshots DIR]

With --hostile, names on the page try to run scripts that set `window.hostile`, and only that is checked. With --many, the
times and the memory of many runs are measured too. With --live, a run of the spec is started while the page is open, and
must appear. Ends with an error at the first thing that is wrong.
"""

import argparse
import json
import re
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

from read_page import DESKTOP, PHONE, open_browser
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

PATIENCE_S = 60


class Served:
    """The page in the browser."""

    def __init__(self, browser: webdriver.Chrome, address: str, screenshots: Path | None):
        self.browser, self.address, self.screenshots = browser, address, screenshots

    def open(self, size: tuple[int, int]):
        width, height = size
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": width, "height": height, "deviceScaleFactor": 1, "mobile": size == PHONE})
        start = time.monotonic()
        self.browser.get(self.address)
        self.wait(lambda: self.count() is not None)
        return time.monotonic() - start

    def wait(self, condition):
        WebDriverWait(self.browser, PATIENCE_S, poll_frequency=0.02).until(lambda _: condition())

    def one(self, selector: str):
        return self.browser.find_element(By.CSS_SELECTOR, selector)

    def all(self, selector: str):
        return self.browser.find_elements(By.CSS_SELECTOR, selector)

    def text(self, selector: str) -> str:
        return self.browser.execute_script("return document.querySelector(arguments[0])?.textContent ?? \"\"", selector)

    def texts(self, selector: str) -> list[str]:
        script = "return [...document.querySelectorAll(arguments[0])].map((one) => one.textContent)"
        return self.browser.execute_script(script, selector)

    def count(self) -> list[int] | None:
        """The number of runs that match the filter, and that of all runs."""
        found = re.fullmatch(r"(\d+) of (\d+) runs", self.text("#count"))
        return [int(number) for number in found.groups()] if found else None

    def filter(self, text: str) -> float:
        """Types a filter, and returns the milliseconds until the table shows its answer."""
        script = """
            const [text, done] = arguments;
            const field = document.getElementById("filter");
            const start = performance.now();
            field.value = text;
            field.dispatchEvent(new Event("input"));
            requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - start)));"""
        return self.browser.execute_async_script(script, text)

    def column(self, name: str) -> list[str]:
        """The visible cells of a column."""
        names = [re.sub(r" [↑↓▲▼]", "", text) for text in self.texts("#table thead th")]
        place = names.index(name) + 1
        return self.texts(f"#table tbody tr:not([aria-hidden]) td:nth-child({place})")

    def sort(self, name: str):
        for button in self.all("#table thead button"):
            if re.sub(r" [↑↓▲▼]", "", button.text) == name:
                self.browser.execute_script("arguments[0].click()", button)
                return
        raise AssertionError(f"there is no column {name}")

    def shoot(self, name: str):
        if self.screenshots:
            self.browser.save_screenshot(str(self.screenshots / f"{name}.png"))

    def check_quiet(self):
        """No script failed, and nothing was asked of any other server."""
        # A wrong query is answered with an error, which the browser logs.
        complaints = [entry for entry in self.browser.get_log("browser")
                      if entry["level"] == "SEVERE" and "/api/sql" not in entry["message"]]
        assert not complaints, complaints
        for entry in self.browser.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                url = message["params"]["request"]["url"]
                assert url.startswith((self.address, "data:", "about:", "chrome")), url


def ask(address: str, path: str, headers: dict[str, str] | None = None, body: str | None = None) -> tuple[int, str]:
    """The status and the text of an answer."""
    data = None if body is None else body.encode()
    request = urllib.request.Request(address + path, data, headers or {})
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def check_guard(address: str):
    """Only this machine's own page and programs are answered, and nothing can be written."""
    port = address.rsplit(":", 1)[1]
    for headers in [{"Host": "evil.example"}, {"Host": f"evil.example:{port}"}, {"Origin": "http://evil.example"},
                    {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}]:
        status, text = ask(address, "/api/runs", headers)
        assert (status, text) == (403, "only pages of this server may ask it"), (headers, status, text)
    for headers in [{}, {"Host": f"localhost:{port}"}, {"Host": f"[::1]:{port}"}, {"Origin": address}]:
        assert ask(address, "/api/tables", headers)[0] == 200, headers
    assert ask(address, "/api/nothing")[0] == 404
    assert ask(address, "/../../etc/passwd")[0] == 404
    assert ask(address, "/api/runs", body="x")[0] == 405
    assert ask(address, "/api/run")[0] == 400
    assert ask(address, "/api/run?run=a/b") == (404, "there is no run a/b")
    status, text = ask(address, "/api/sql", body="delete from runs")
    assert status == 400 and "the query can't be answered" in text, text
    listening = subprocess.run(["ss", "-ltnH"], capture_output=True, text=True, check=False).stdout
    own = [line.split()[3] for line in listening.splitlines() if f":{port} " in line]
    assert all(place == f"127.0.0.1:{port}" for place in own), own


def check_runs(page: Served):
    page.open(DESKTOP)
    found, everything = page.count()
    assert found == everything > 0
    page.shoot("runs")
    name = page.column("run")[0]
    page.filter(f'"{name}"')
    assert page.count()[0] >= 1 and all(name in text for text in page.column("run"))
    page.filter("latent>3 status=done")
    done = page.count()[0]
    assert done > 0 and set(page.column("status")) == {"done"}
    page.filter("nothing=3")
    assert page.text("#state") == "there is no column nothing"
    page.filter("no such run")
    assert page.count()[0] == 0
    page.filter("status=done")
    page.sort("contact_force r2")
    values = [float(text.replace("−", "-")) for text in page.column("contact_force r2") if text != "–"]
    assert values == sorted(values, reverse=True), values
    Select(page.one("#group")).select_by_value("experiment")
    groups = page.texts("#table tr.group")
    assert groups and sum(int(re.search(r"\((\d+)\)", text)[1]) for text in groups) == page.count()[0]
    page.shoot("groups")
    page.browser.execute_script("document.querySelector('#table tr.group').click()")
    assert len(page.texts("#table tbody tr:not(.group):not([aria-hidden])")) > 0
    Select(page.one("#group")).select_by_value("")


def check_chosen(page: Served):
    for place in range(2):
        page.browser.execute_script(f"document.querySelectorAll('#table tbody tr:not([aria-hidden])')[{place}].click()")
        page.wait(lambda place=place: len(page.all("#chosen .uplot")) > 0 and len(page.all("tr.chosen")) == place + 1)
    page.wait(lambda: page.text("#chosen h2") == "2 runs")
    assert "Settings that differ" in page.text("#chosen")
    chart = page.one("#chosen .chart .place")
    page.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", chart)
    page.shoot("chosen")
    ActionChains(page.browser).move_to_element(chart).perform()
    tooltip = page.one("#chosen .chart .tooltip")
    page.wait(tooltip.is_displayed)
    assert tooltip.text.startswith("epoch "), tooltip.text
    chart.send_keys(Keys.END)
    last = tooltip.text
    chart.send_keys(Keys.HOME)
    assert tooltip.text != last and tooltip.text.startswith("epoch 1"), (tooltip.text, last)
    entry = page.one("#chosen .u-legend .u-series:nth-child(2)")
    page.browser.execute_script("arguments[0].querySelector('th').click()", entry)
    assert "u-off" in entry.get_attribute("class")
    page.browser.execute_script("for (const one of document.querySelectorAll('#chosen details')) one.open = true")
    page.shoot("details")
    for _ in range(2):
        page.browser.execute_script("document.querySelector('tr.chosen').click()")
    page.wait(lambda: page.text("#chosen") == "")


def check_claims_and_sql(page: Served):
    page.one("#tab-claims").click()
    page.wait(lambda: len(page.all("#claims tbody tr")) > 30)
    page.shoot("claims")
    page.one("#tab-claims").send_keys(Keys.ARROW_RIGHT)
    page.wait(lambda: "runs" in page.texts("#columns summary"))
    question = page.one("#question")
    question.clear()
    question.send_keys("select status, count(*) as n from runs group by status order by status")
    question.send_keys(Keys.CONTROL, Keys.ENTER)
    page.wait(lambda: len(page.all("#answer tbody tr")) > 0)
    assert "rows in" in page.text("#asked") or "row" in page.text("#asked")
    page.shoot("sql")
    question.clear()
    question.send_keys("select nope from runs")
    page.one("#ask button").click()
    page.wait(lambda: "there is no column 'nope'" in page.text("#asked"))
    page.one("#tab-runs").click()


def check_phone(page: Served):
    page.open(PHONE)
    wide = page.browser.execute_script("return document.documentElement.scrollWidth")
    assert wide <= PHONE[0], f"the page is {wide} pixels wide"
    page.shoot("phone")


def check_many(page: Served, process: subprocess.Popen):
    """The limits for 10,000 runs: first view in 1 s, filtering in 100 ms, memory below 500 MB."""
    page.open(DESKTOP)
    first = page.open(DESKTOP)
    times = sorted(page.filter(text) for text in ["latent>3", "seed=7 status=done", "empty", '"contact_force r2">0.5', ""])
    status = Path(f"/proc/{process.pid}/status").read_text()
    megabytes = int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1000
    print(f"first view {first:.2f} s, filter {times[len(times) // 2]:.0f} ms (most {times[-1]:.0f}), memory {megabytes:.0f} MB, "
          f"{page.count()[1]} runs")
    assert first < 1 and times[-1] < 100 and megabytes < 500


def check_live(page: Served, harness: str, results: str, spec: str):
    """A run that is started while the page is open appears, and so do its curves and metrics when it is done."""
    page.open(DESKTOP)
    before = page.count()[1]
    command = [harness, "--results", results, "run", spec, "seeds=[77]", "scenarios=[empty]", "tasks=[prediction]",
               "training.epochs=400", "training.patience=null"]
    training = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    page.wait(lambda: page.count()[1] == before + 1)
    page.filter("seed=77")
    assert page.column("status") == ["running"]
    page.browser.execute_script("document.querySelector('#table tbody tr:not([aria-hidden])').click()")
    page.wait(lambda: page.text("#chosen h2") != "")
    assert training.wait(PATIENCE_S) == 0
    page.wait(lambda: page.column("status") == ["done"])
    page.wait(lambda: "Metrics on test episodes" in page.text("#chosen"))
    page.wait(lambda: len(page.all("#chosen .uplot")) > 0)
    page.shoot("live")


def check_hostile(page: Served):
    """Names, reasons and settings of runs are shown as texts."""
    page.open(DESKTOP)
    for row in range(min(8, page.count()[1])):
        page.browser.execute_script(f"document.querySelectorAll('#table tbody tr:not([aria-hidden])')[{row}].click()")
    time.sleep(2)
    page.one("#tab-claims").click()
    page.one("#tab-sql").click()
    page.one("#question").clear()
    page.one("#question").send_keys("select * from runs", Keys.CONTROL, Keys.ENTER)
    page.wait(lambda: len(page.all("#answer tbody tr")) > 0)
    assert page.browser.execute_script("return window.hostile") is None


def main():
    parser = argparse.ArgumentParser()
    for name in ["harness", "results", "chromium", "driver"]:
        parser.add_argument(name)
    parser.add_argument("--hostile", action="store_true")
    parser.add_argument("--many", action="store_true")
    parser.add_argument("--live")
    parser.add_argument("--screenshots", type=Path)
    chosen = parser.parse_args()
    command = [chosen.harness, "--results", chosen.results, "serve", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().split()[0]
        with tempfile.TemporaryDirectory() as profile:
            browser = open_browser(chosen.chromium, chosen.driver, profile)
            try:
                page = Served(browser, address, chosen.screenshots)
                if chosen.hostile:
                    check_hostile(page)
                elif chosen.many:
                    check_many(page, process)
                else:
                    check_guard(address)
                    check_runs(page)
                    check_chosen(page)
                    check_claims_and_sql(page)
                    check_phone(page)
                    if chosen.live:
                        check_live(page, chosen.harness, chosen.results, chosen.live)
                page.check_quiet()
            finally:
                browser.quit()
    finally:
        process.terminate()
        assert process.wait(10) == 0, "SIGTERM must end the server well"
    print("the page works")


if __name__ == "__main__":
    main()
